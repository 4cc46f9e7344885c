"""Data sets: one class and one batch type, readers that hide each layout's oddities, the maker of data sets."""
