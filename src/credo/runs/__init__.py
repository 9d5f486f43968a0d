"""What touches disk, clock or screen."""
