"""The tables of the paper: their runs, and reports that put the paper's figures beside ours."""
