"""What is recorded: captures, their noise, and simulated recordings."""
