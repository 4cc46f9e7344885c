"""Drawing, for every other room: meshes as pictures, pictures in rows and columns, and the files they go into."""
