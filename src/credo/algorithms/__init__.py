"""One file, one published box."""
