"""Studies: configuration, the run, results, report and the command line."""
