"""What a person wants to run: a name, options or a file become a `Scenario`, ready to be solved."""

from .observed import Places, Wanted
from .paper import BUILT_IN, SCENARIOS, SOURCES
from .reader import ScenarioError, read_text
from .scenario import Options, Scenario, Settings
from .written import SCHEMES, VIEWS, library, parse_change, read, templates, title

__all__ = [
    "BUILT_IN",
    "SCENARIOS",
    "SCHEMES",
    "SOURCES",
    "VIEWS",
    "Options",
    "Places",
    "Scenario",
    "ScenarioError",
    "Settings",
    "Wanted",
    "library",
    "parse_change",
    "read",
    "read_text",
    "templates",
    "title",
]
