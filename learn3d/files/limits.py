"""Limits of untrusted files.

Real data are far below them, as the comments say; so there are no options for them.

`sandbox` limits the memory and the time of reading.
"""

MIB, GIB = 2**20, 2**30

# Text and JSON
TEXT_BYTES = 16 * MIB  # list of ids, table or config.json; all ids of ShapeNet: 2 MB
# poses.csv, for about 60,000 photographs; it takes 80 times as much memory
PHOTO_TABLE_BYTES = 4 * MIB
JSON_BYTES = 16 * MIB  # splits.json: 2 MB; test.json of a run on 10,000 objects: 1 MB
METRICS_BYTES = 256 * MIB  # metrics.jsonl; a million lines
CURVES = 100  # curves in metrics.jsonl, each a panel of a figure; ours: 20
CURVE_NAME = 60  # characters
NAME_LENGTH = 200  # characters of an object's id, which is part of file names

# Arrays and archives
ARRAY_BYTES = 16 * GIB  # array; the images of Kato's largest category: 2.4 GiB
OBJECT_BYTES = 64 * MIB  # array of one object (cameras, points); 100,000 points with normals: 5 MB
EXPANSION = 300  # unpacked over packed size of an array above SMALL_BYTES; images: 20
SMALL_BYTES = 64 * MIB  # EXPANSION does not apply to smaller arrays
VOLUME_BYTES = 4 * MIB  # voxel file (.mat); 32^3 cells: 0.3 MB as float64

# Images
IMAGE_FILE_BYTES = 256 * MIB
IMAGE_SIDE = 10_000  # pixels; a photograph of this side, padded to a square: 400 MB
IMAGE_PIXELS = 64_000_000  # decoding, masking and framing take about 40 bytes per pixel
MASK_SIZE = 64  # side of stored silhouettes in pixels, as published
RENDER_SIDE = 2048  # pixels, for renderings of a data set; published ones: up to 224

# Meshes
# mesh file, and each file that it refers to; the largest of ShapeNet: 100 MB
MESH_FILE_BYTES = 256 * MIB

# Weights
WEIGHTS_BYTES = GIB  # pretrained weights; ResNet-18: 45 MB

# Options of a configuration
VIEW_CLASSES = 100_000  # cells of azimuth and elevation; 512 in the papers

# Cameras
ANGLE_DEG = 36_000.0  # azimuths; a hundred turns, at which the spacing of float32 is 0.004 degrees
CAMERA_DISTANCE = (1e-3, 1e4)  # lengths of the object
FOV_DEG = (0.1, 170.0)  # full field of view; a telescope: 0.5
