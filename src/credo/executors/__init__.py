"""Where many runs are trained: one call, `run(jobs, workers)`, for each kind of machine."""
