"""What goes wrong with a mesh: the one error of this room.

What enters: a sentence. What leaves: an exception that callers can catch, as a `ValueError` or by its own name.
"""


class MeshError(ValueError):
    """A mesh that cannot carry differential operators, or a file that holds none.

    The message says what was expected, what was found (the first offending index) and what to do. Indices of vertices
    and faces count from 0, in the order of the file or of the arrays handed in.
    """
