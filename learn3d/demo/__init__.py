"""The page of `learn3d demo`: `picture_tab` and `fit_tab` compute, `page` lays it out and serves it (extra `demo`)."""
