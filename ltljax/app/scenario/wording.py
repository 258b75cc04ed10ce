"""Names and texts as messages show them: cut where they are long, with the nearest of the known names."""

import difflib
from collections.abc import Collection, Iterable

LONGEST_LIST = 400


def cut(text: str, longest: int) -> str:
    """The text, or its beginning and three dots where it is longer than ``longest`` characters."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def listed(names: Collection[str]) -> str:
    """The names separated by commas, cut where the list is long."""
    return cut(", ".join(names), LONGEST_LIST) or "nothing"


def did_you_mean(word: object, allowed: Iterable[str]) -> str:
    """A hint at the allowed name that is nearest to a word; empty if none is near."""
    near = difflib.get_close_matches(str(word)[:100], list(allowed), n=1)
    return f" (did you mean {cut(near[0], 40)}?)" if near else ""
