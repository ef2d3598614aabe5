"""What the evaluated candidates say about the arg-min of Δ over B, and about the machine."""
