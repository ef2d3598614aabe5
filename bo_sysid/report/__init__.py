"""Reports: figures and text. They show what a run folder holds, and compute nothing."""
