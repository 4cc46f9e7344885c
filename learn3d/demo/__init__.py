"""The page of `learn3d demo` (extra `demo`): `server` serves it behind `gate`, `picture` computes, `page/` is seen."""
