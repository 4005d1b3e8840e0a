"""Monte Carlo studies of calibrations: specification, trials, store, executors, results."""
