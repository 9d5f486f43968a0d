"""What needs a gradient and knows no population."""
