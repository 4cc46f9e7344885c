"""The paper's figures from saved checkpoints, and the picture grid that a run draws while it trains."""
