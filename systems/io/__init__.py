"""Real devices and recordings."""
