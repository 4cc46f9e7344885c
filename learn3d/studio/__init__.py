"""Work with trained models: pictures to meshes, poses from masks, generated shapes, data sets, tables.

The rest of learn3d never imports this package.
"""
