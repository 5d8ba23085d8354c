"""Pairs files: text with one image pair a line, as hloc and COLMAP read and write them."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from hm_sfm.errors import InputError
from hm_sfm.io.atomic import replace_file
from hm_sfm.types import ImagePair

MAX_NAMES_LISTED = 20

# One name of a pairs file: in double quotes (a quote inside is doubled), or bare.
NAME = r'(?:"(?:[^"]|"")*"|[^ \t"][^ \t]*)'
TWO_NAMES = re.compile(rf"[ \t]*({NAME})[ \t]+({NAME})[ \t]*")
# What may stand bare: no white space or quote, and no comment or byte-order mark at its start.
BARE_NAME = re.compile(r'[^\s"#\ufeff][^\s"]*')


def read_pairs(path: Path, names: Sequence[str]) -> tuple[ImagePair, ...]:
    """Read a pairs file, in the order of its lines: one pair a line, the two names separated by a space or a tab.

    A name with spaces stands in double quotes (a quote inside is doubled), or a single tab separates the names. Blank
    lines and lines that start with # are ignored. A pair that stands there again, in either order, counts once: hloc's
    pairs_from_retrieval writes both "a b" and "b a".

    Raises InputError, naming file and line, where the file cannot be read, a line does not hold two names, an image
    is unknown (all unknown ones are listed) or paired with itself; and where there is no pair at all.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read the pairs file {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"the pairs file {path} is not UTF-8 text") from error

    known = set(names)
    unknown: dict[str, int] = {}
    pairs: dict[ImagePair, None] = {}
    # Not splitlines(), which also splits at characters that may stand in names.
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.removesuffix("\r")
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        name_a, name_b = _parse_line(line, where)
        for name in (name_a, name_b):
            if name not in known:
                unknown.setdefault(name, number)
        if name_a == name_b:
            raise InputError(f"{where}: {name_a!r} is paired with itself")
        pairs.setdefault(ImagePair.of(name_a, name_b))
    if unknown:
        listed = [f"{name!r} (line {number})" for name, number in unknown.items()]
        rest = f" and {len(listed) - MAX_NAMES_LISTED} more" if len(listed) > MAX_NAMES_LISTED else ""
        raise InputError(f"{path} names images that are not there: {', '.join(listed[:MAX_NAMES_LISTED])}{rest}")
    if not pairs:
        raise InputError(f"the pairs file {path} holds no pair")
    return tuple(pairs)


def write_pairs(path: Path, pairs: Iterable[ImagePair]) -> None:
    """Write a pairs file that `read_pairs`, and where no name needs quotes also hloc and COLMAP, can read.

    Raises InputError where a name holds a line break.
    """
    lines = [f"{_quote(pair.name0)} {_quote(pair.name1)}\n" for pair in pairs]
    with replace_file(path) as temporary:
        temporary.write_bytes("".join(lines).encode())


def _parse_line(line: str, where: str) -> tuple[str, str]:
    match = TWO_NAMES.fullmatch(line)
    parts = match.groups() if match else [part.strip(" ") for part in line.strip().split("\t")]
    if len(parts) != 2 or not all(parts):
        raise InputError(
            f"{where}: expected two names, found {line.strip()[:100]!r}; names with spaces "
            "need double quotes, or a tab between the two"
        )
    return _unquote(parts[0]), _unquote(parts[1])


def _quote(name: str) -> str:
    if "\n" in name or "\r" in name:
        raise InputError(f"the image name {name!r} contains a line break, which a pairs file cannot hold")
    return name if BARE_NAME.fullmatch(name) else '"' + name.replace('"', '""') + '"'


def _unquote(text: str) -> str:
    is_quoted = len(text) >= 2 and text.startswith('"') and text.endswith('"')
    return text[1:-1].replace('""', '"') if is_quoted else text
