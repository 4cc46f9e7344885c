"""Drawing, for every other room: meshes as pictures, pictures in rows and columns, and the files they go into.

`studio` photographs a mesh, `surfaces` draws predicted shapes from any side, `sheets` arranges and saves pictures,
`contact_sheet` shows a data set.
"""
