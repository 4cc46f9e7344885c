"""The tables and figures of the paper, and the HTML report: runs are planned, trained, measured and shown."""
