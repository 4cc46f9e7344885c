"""Networks: encoders, generators, discriminators. Settings choose them by name."""
