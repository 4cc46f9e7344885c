"""Drawing for all other rooms: meshes as pictures, pictures in rows and columns, image files."""
