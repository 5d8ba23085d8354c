"""Names of files and folders that file systems accept."""


def cut_name(name: str, most_bytes: int) -> str:
    """The beginning of a name, in at most so many bytes of UTF-8: file systems allow 255, endings included."""
    return name.encode()[:most_bytes].decode(errors="ignore")
