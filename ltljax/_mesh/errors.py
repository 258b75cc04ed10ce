"""What goes wrong with a mesh: the one error of this room.

What enters: a sentence. What leaves: an exception that callers can catch, as a `ValueError` or by its own name.
"""


def in_one_line(message: str) -> str:
    """A message without line breaks and without the control characters that a file may hold and a terminal obeys."""
    words = " ".join(message.split())
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in words)


class UnreadableError(Exception):
    """What a reader reports about a file that it could not read; `files` makes it a sentence."""


class MeshError(ValueError):
    """A mesh that cannot carry differential operators, or a file that holds none.

    The message says what was expected, what was found (the first offending index) and what to do. Indices of vertices
    and faces count from 0, in the order of the file or of the arrays handed in.
    """
