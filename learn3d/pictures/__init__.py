"""Drawing for the other packages: meshes as pictures, pictures in rows and columns, image files."""
