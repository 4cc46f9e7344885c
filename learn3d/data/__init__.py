"""Data sets: one class and one batch type for all layouts, and a reader for each layout."""
