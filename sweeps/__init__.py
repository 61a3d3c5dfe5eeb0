"""The front door: command line, grids of runs, run folders and reports."""
