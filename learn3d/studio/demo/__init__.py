"""The page of `learn3d demo` (extra `demo`): `server` serves the files of `page/`, `picture` makes meshes."""
