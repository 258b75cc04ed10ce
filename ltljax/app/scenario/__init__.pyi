from .catalogue import library as library, templates as templates, title as title
from .measurements import FitTask as FitTask, Places as Places
from .reading import parse_change as parse_change, read as read
from .scenario import Scenario as Scenario, Settings as Settings
from .tables import ScenarioError as ScenarioError, read_text as read_text
