"""Bounds on what is read from files that somebody else may have made: one place, each with its unit and its reason.

They are checked before memory is taken for what a file claims to hold. Real data stay far below all of them (the
comments say by how much), so none can be changed from outside. docs/untrusted-inputs.md lists who checks what.
"""

MIB, GIB = 2**20, 2**30

# Text and JSON
TEXT_BYTES = 64 * MIB  # a list of ids; those of all of ShapeNet take 2
PHOTO_TABLE_BYTES = 16 * MIB  # poses.csv: some 250,000 photographs; in memory it takes 80 times its size
TABLE_BYTES = MIB  # the cameras of one object (view.txt): 24 rows take 2 kB
CONFIG_BYTES = MIB  # config.json of a run: 2 kB
JSON_BYTES = 64 * MIB  # splits.json: 2 MB; test.json of a run on 10,000 objects: 1 MB
JSON_DEPTH = 32  # levels of nesting; no file of ours has more than five
METRICS_BYTES = 256 * MIB  # metrics.jsonl: a million lines
CURVES = 100  # numbers that they log, each a panel of a figure; ours log 20
CURVE_NAME = 60  # characters
OBJECTS = 1_000_000  # objects of a split, photographs in a table; all of ShapeNet has 51,300
NAME_LENGTH = 200  # characters of an object's id, which becomes part of a file name

# Arrays and archives
ARRAY_BYTES = 16 * GIB  # one array, and one archive, unpacked; the images of Kato's largest category take 2.4
OBJECT_BYTES = 64 * MIB  # arrays of one object (cameras, points); 100,000 points with normals take 5
EXPANSION = 300  # unpacked over packed size of an array above SMALL_BYTES whose size nothing else tells; images have 20
SMALL_BYTES = 64 * MIB  # below, no expansion is suspect
DEFLATE_EXPANSION = 1032  # what deflate can do at most: an archive that promises more has members that overlap
ZIP_MEMBERS = 400_000  # a pack of 200,000 meshes
ZIP_DIRECTORY_BYTES = 64 * MIB  # its table of contents: 24 MB; Python takes ten times as much for it
PICKLED_ARRAYS = 200_000  # arrays in a pickled array of arrays; Pascal3D+ has 5,000
VOLUME_BYTES = 4 * MIB  # a voxel file (.mat, .binvox) of 32^3 cells: 0.3 as float64, 0.07 as runs of one

# Images
IMAGE_FILE_BYTES = 256 * MIB
IMAGE_SIDE = 10_000  # pixels; photographs are padded to squares: 400 MB
IMAGE_PIXELS = 64_000_000  # a photograph; decoding, masking and framing take 29 bytes for each
SQUARE_SIDE = 16_000  # that an object is cut out with: a network's objects take 65 % of it, of 10,000 pixels
RENDER_SIDE = 2048  # pixels, renderings of a data set; published ones have up to 224, and 16 are read at once

# Meshes
MESH_FILE_BYTES = 256 * MIB  # and of each file that it refers to; the largest of ShapeNet has some 100
MESH_VERTICES = 20_000_000
MESH_FACES = 20_000_000  # `max_faces` of make_dataset, 1,000,000, is the one that counts
MESH_MEMORY = 8 * GIB  # bytes that reading one mesh may add; trimesh takes some 20 times a text file's size
MESH_SECONDS = 300.0  # for reading one mesh file; one of 100 MB takes 20
POLYGON_CORNERS = 2000  # of one polygon of a text format: cutting ears takes the square of it, or its cube

# Debian packages
PACKAGE_BYTES = 16 * GIB  # all files of a package, read past or not; FlightGear's have 0.4
PACKAGE_MEMBERS = 1_000_000
PACKAGE_WANTED_BYTES = 2 * GIB  # its catalogues, or models, held at a time; FlightGear's have less than 0.4
CATALOGUE_MEMBER_BYTES = 64 * MIB  # one file inside a catalogue; the largest wanted today is a 9 MB model

# Checkpoints and weights
CHECKPOINT_BYTES = 16 * GIB  # one with optimizer states: 0.7
CHECKPOINT_HEADER_BYTES = 16 * MIB  # names, shapes and metadata: 50 kB
WEIGHTS_BYTES = GIB  # pretrained weights: ResNet-18 has 45 MB
WEIGHTS_MEMORY = 256 * MIB  # bytes that reading them may add, beside four times the file's size
WEIGHTS_SECONDS = 60.0  # for reading them: 0.1

# Options: what a configuration may ask for
ITERATIONS = 10**9  # steps
VIEW_CLASSES = 100_000  # cells of azimuth and elevation; 512 in the papers
CLASSES = 10_000  # categories trained together

NUMBER = 1e30  # of any measured or given value: float32 ends at 3e38, and NumPy keeps no whole number beyond 2^64

# Cameras
ANGLE_DEG = 36_000.0  # azimuths may be counted over a hundred turns; float32 still tells 0.004 degrees apart
DISTANCE = (1e-3, 1e4)  # lengths of the object
FOV_DEG = (0.1, 170.0)  # full field of view; a telescope's has 0.5
