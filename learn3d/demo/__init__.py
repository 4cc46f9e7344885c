"""The page of `learn3d demo`: `picture` computes, `page` lays it out and serves it, behind `gate` (extra `demo`)."""
