"""Pages about trained runs that open in a browser, each one HTML file that needs nothing else."""
