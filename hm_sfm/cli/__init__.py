"""The command hm-sfm: parse the arguments, run a command, turn errors into one line and an exit code."""

import logging
import sys
import warnings
from collections.abc import Sequence

from hm_sfm.cli.parser import make_parser
from hm_sfm.cli.terminal import LogHandler, Terminated, leave_broken_pipe, open_streams, say_last, stop_on_terminate
from hm_sfm.errors import HmSfmError

__all__ = ["main", "make_parser"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    open_streams()
    try:
        with stop_on_terminate():
            options = make_parser().parse_args(arguments)
            level = logging.ERROR if options.quiet else logging.WARNING
            logging.basicConfig(format="%(levelname)s: %(message)s", level=level, handlers=[LogHandler(sys.stderr)])
            if not sys.warnoptions:
                warnings.simplefilter("ignore")  # of libraries to programmers
            code = options.run(options)
            sys.stdout.flush()
            return code
    except HmSfmError as error:
        say_last(str(error))
        return error.exit_code
    except BrokenPipeError:  # hm-sfm ... | head
        leave_broken_pipe()
        return 141
    except OSError as error:
        say_last(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        return 2
    except KeyboardInterrupt as interrupt:
        is_terminated = isinstance(interrupt, Terminated)
        say_last(f"{'terminated' if is_terminated else 'interrupted'}; run the same command again to continue")
        return 143 if is_terminated else 130
