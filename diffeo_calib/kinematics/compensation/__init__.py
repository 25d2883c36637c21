"""Joint commands that bring a calibrated robot's tool to its targets."""
