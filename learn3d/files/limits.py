"""Bounds of files that somebody else may have made.

Memory, time and crashes of the libraries that decode are left to `sandbox`. Real data stay far below all of
these (the comments say by how much), so none can be changed from outside.
"""

MIB, GIB = 2**20, 2**30

# Text and JSON
TEXT_BYTES = 16 * MIB  # a list of ids; those of all of ShapeNet take 2
PHOTO_TABLE_BYTES = 4 * MIB  # poses.csv: some 60,000 photographs; in memory it takes 80 times its size
TABLE_BYTES = MIB  # the cameras of one object (view.txt): 24 rows take 2 kB
CONFIG_BYTES = MIB  # config.json of a run: 2 kB
JSON_BYTES = 16 * MIB  # splits.json: 2 MB; test.json of a run on 10,000 objects: 1 MB
METRICS_BYTES = 256 * MIB  # metrics.jsonl: a million lines
CURVES = 100  # numbers that they log, each a panel of a figure; ours log 20
CURVE_NAME = 60  # characters
NAME_LENGTH = 200  # characters of an object's id, which becomes part of a file name

# Arrays and archives
ARRAY_BYTES = 16 * GIB  # one array; the images of Kato's largest category take 2.4
OBJECT_BYTES = 64 * MIB  # arrays of one object (cameras, points); 100,000 points with normals take 5
EXPANSION = 300  # times its packed size that an array above SMALL_BYTES may take; images take 20 times
SMALL_BYTES = 64 * MIB  # smaller arrays may take any number of times their packed size
VOLUME_BYTES = 4 * MIB  # a voxel file (.mat, .binvox) of 32^3 cells: 0.3 as float64, 0.07 as runs of one

# Images
IMAGE_FILE_BYTES = 256 * MIB
IMAGE_SIDE = 10_000  # pixels; photographs are padded to squares: 400 MB
IMAGE_PIXELS = 64_000_000  # a photograph; decoding, masking and framing take some 40 bytes for each
RENDER_SIDE = 2048  # pixels, renderings of a data set; published ones have up to 224

# Meshes
MESH_FILE_BYTES = 256 * MIB  # and of each file that it refers to; the largest of ShapeNet has some 100

# Weights
WEIGHTS_BYTES = GIB  # pretrained weights: ResNet-18 has 45 MB

# Options: what a configuration may ask for
ITERATIONS = 10**9  # steps
VIEW_CLASSES = 100_000  # cells of azimuth and elevation; 512 in the papers

# Cameras
ANGLE_DEG = 36_000.0  # azimuths may be counted over a hundred turns; float32 still tells 0.004 degrees apart
DISTANCE = (1e-3, 1e4)  # lengths of the object
FOV_DEG = (0.1, 170.0)  # full field of view; a telescope's has 0.5
