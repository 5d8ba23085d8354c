"""Hidden files that mark folders as made by hm_sfm, so that nothing in them is taken for a photo."""

from pathlib import Path

RUN_MARKER = ".hm_sfm"
"""In OUT, the folder of a run."""
MADE_MARKER = ".made_by_hm_sfm"
"""In the folder of a conversion."""


def is_marked(folder: Path) -> bool:
    """Whether hm_sfm made the folder: OUT of a run, or what it was converted to."""
    return (folder / RUN_MARKER).exists() or (folder / MADE_MARKER).exists()
