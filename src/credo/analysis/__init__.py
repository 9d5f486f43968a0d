"""What explains a finished policy."""
