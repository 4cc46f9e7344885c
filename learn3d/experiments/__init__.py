"""The tables of the paper: which runs they need, running them, and reports that put the paper's figures beside ours."""
