"""The page of `learn3d demo` (extra `demo`): `server` and `gate` serve the files of `page/`, `picture` makes meshes."""
