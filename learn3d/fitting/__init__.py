"""Fits predictions to pictures: mask, camera, shape and colours; and detects unknown objects."""
