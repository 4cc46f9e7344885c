import sys

from learn3d.commands import main

sys.exit(main())
