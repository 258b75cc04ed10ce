"""The exception for meshes that cannot be used, and the cleaning of messages."""


def in_one_line(message: str) -> str:
    """The message without line breaks, and with control characters escaped.

    Messages quote files, and a terminal would interpret the control characters in them.
    """
    words = " ".join(message.split())
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in words)


class UnreadableError(Exception):
    """Raised by a reader that cannot read a file; `files` turns the reason into a `MeshError`."""


class MeshError(ValueError):
    """Raised for a mesh that is not a valid surface, and for a file that does not contain one.

    The message states what was expected, what was found (with the first offending index) and what to do. Indices of
    vertices and faces count from 0, in the order of the file or of the arrays passed in.
    """
