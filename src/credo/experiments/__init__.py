"""One file, one figure or table of the dissertation."""
