"""Makes `python -m hm_sfm.cli` the same as `hm-sfm`, for torchrun."""

import sys

from hm_sfm.cli import main

if __name__ == "__main__":
    sys.exit(main())
