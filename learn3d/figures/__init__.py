"""The paper's figures of trained runs, and the picture grid that a run draws while it trains."""
