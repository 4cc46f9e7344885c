"""The paper's figures from saved checkpoints, and the picture grid that a run draws while it trains.

`grids` and `interpolation` put pictures of shapes together; `codes`, `curves` and `polar` are plots (extra `figures`,
loaded when used); `runs` opens checkpoints with their data, `paper` draws each figure.
"""
