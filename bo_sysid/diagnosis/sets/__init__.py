"""Sets of effects: scored by linear algebra, fitted through the simulator, compared by rules."""
