"""Estimates camera poses from masks, and draws a sheet to check them by eye."""
