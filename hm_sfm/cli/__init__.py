"""The command hm-sfm: parse the arguments, run a command, turn errors into one line and an exit code."""

import logging
import sys
from collections.abc import Sequence

from hm_sfm.cli.parser import make_parser
from hm_sfm.errors import HmSfmError

__all__ = ["main", "make_parser"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    try:
        options = make_parser().parse_args(arguments)
        level = logging.ERROR if options.quiet else logging.WARNING
        logging.basicConfig(format="%(levelname)s: %(message)s", level=level)
        return options.run(options)
    except HmSfmError as error:
        print(f"hm-sfm: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else " ".join(str(error).split())
        print(f"hm-sfm: {text}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("hm-sfm: interrupted; run the same command again to continue", file=sys.stderr)
        return 130
