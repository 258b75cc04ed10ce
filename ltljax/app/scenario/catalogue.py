"""The scenario files that come with the package: their names, texts and titles. Loads neither JAX nor NumPy."""

import tomllib
from importlib.resources import files

# Scenarios by their names in version 0.1.
RENAMED = {"turk": "turing-ridges"}


def library() -> dict[str, str]:
    """The texts of the scenarios that come with the package, by name."""
    return _texts("library")


def templates() -> dict[str, str]:
    """The texts of scenario files to start from, by name: those of the library, and those that need files of data."""
    return library() | _texts("templates")


def title(text: str) -> str:
    """The title of a scenario of the library."""
    return str(tomllib.loads(text)["title"])


def _texts(folder: str) -> dict[str, str]:
    entries = (files("ltljax.app.scenario") / folder).iterdir()
    texts = {
        entry.name.removesuffix(".toml"): entry.read_text(encoding="utf-8")
        for entry in entries if entry.name.endswith(".toml")
    }  # fmt: skip
    return dict(sorted(texts.items()))
