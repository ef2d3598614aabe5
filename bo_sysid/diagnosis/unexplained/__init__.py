"""What no named effect explains, and a force law of no name that is learned for it."""
