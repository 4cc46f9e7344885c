"""The tables of the paper: planning and training their runs, and reports with the paper's values beside ours."""
