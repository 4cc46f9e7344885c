"""A picture of an object to a mesh: prediction, camera, fitted shape, colours; and warnings of unknown objects."""
