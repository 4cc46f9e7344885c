"""Tables and figures of the paper, and the HTML report: runs are planned, measured, shown."""
