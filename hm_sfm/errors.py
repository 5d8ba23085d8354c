"""Everything that can be expected to go wrong, as users see it: one clear sentence and an exit code."""


class HmSfmError(Exception):
    """Base of all expected failures. The text is one sentence that names the file or option at fault."""

    exit_code = 2


class InputError(HmSfmError):
    """A file, folder or argument given by the user cannot be used."""


class ConfigError(HmSfmError):
    """A configuration key or value is unknown or out of range."""


class WeightsError(HmSfmError):
    """A weights file is damaged, is not one of hm_sfm's, or does not fit the configured network."""


class StaleResultError(HmSfmError):
    """A stored result was made from other inputs or with another configuration than the present ones."""


class MissingPackageError(HmSfmError):
    """A package that only some commands need is not installed."""


class WorkerLostError(HmSfmError):
    """The processes that match pairs died again and again."""


class NoModelError(HmSfmError):
    """The mapper could not build a model; database and matches are kept."""

    exit_code = 3
