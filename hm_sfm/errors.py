"""What can go wrong, as the user sees it: one clear sentence and an exit code."""


class HmSfmError(Exception):
    """Base of all expected failures. Its text is one sentence that names the file or option at fault."""

    exit_code = 2


class InputError(HmSfmError):
    """A file, folder or argument that the user gave is unusable."""


class ConfigError(HmSfmError):
    """A configuration key or value is unknown or out of range."""


class WeightsError(HmSfmError):
    """A weights file is damaged, foreign or does not fit the configured network."""


class StaleResultError(HmSfmError):
    """A stored result was made from other inputs or another configuration than the present ones."""


class MissingPackageError(HmSfmError):
    """A package that only some commands need is not installed."""


class WorkerLostError(HmSfmError):
    """Processes that matched pairs died again and again."""


class NoModelError(HmSfmError):
    """The mapper found no model; database and matches are kept."""

    exit_code = 3
