"""What a decision amounts to: names, magnitudes, words, the hold-out, the repaired study."""
