"""The longest functions and files of the project: `python tests/sizes.py [NUMBER]` prints them.

A line of code is a line that is neither blank, nor only a comment, nor part of a docstring. Lines of a signature count.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("ltljax", "tests", "benchmarks", "docs")


def files() -> list[Path]:
    """All Python files of the project."""
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def functions(path: Path) -> list[tuple[str, int]]:
    """The functions of a file that are not inside another function, with their numbers of lines of code."""
    text = path.read_text()
    lines, tree = text.splitlines(), ast.parse(text)
    bodies = [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    sizes = []
    for body in bodies:
        for node in body.body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                prefix = f"{body.name}." if isinstance(body, ast.ClassDef) else ""
                sizes.append((prefix + node.name, _lines_of_code(node, lines)))
    return sizes


def _lines_of_code(node: ast.AST, lines: list[str]) -> int:
    numbers = set(range(node.lineno, node.end_lineno + 1))
    for inner in ast.walk(node):
        if isinstance(inner, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(inner) is not None:
            numbers -= set(range(inner.body[0].lineno, inner.body[0].end_lineno + 1))
    return sum(1 for number in numbers if lines[number - 1].strip() and not lines[number - 1].lstrip().startswith("#"))


def main(number: int = 10) -> None:
    """Print the longest functions and files."""
    sizes = [(size, f"{path.relative_to(ROOT)}: {name}") for path in files() for name, size in functions(path)]
    print("lines of code, function")
    for size, name in sorted(sizes, reverse=True)[:number]:
        print(f"{size:5} {name}")
    print("lines, file")
    for size, name in sorted(((len(path.read_text().splitlines()), path) for path in files()), reverse=True)[:number]:
        print(f"{size:5} {name.relative_to(ROOT)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
