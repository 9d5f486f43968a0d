"""What people look at: pages, figures and films of runs and of results."""
