# Public names: `__init__.py` imports each on first access.
from . import interop as interop
from . import mjcf as mjcf
from . import robots as robots
from .datasets import rlds as rlds
from .datasets.episodes import Episodes as Episodes
from .env import Env as Env
from .experts.collection import collect as collect
from .making import make as make
from .scene.ranges import Randomization as Randomization
from .state import State as State
from .state import Trajectory as Trajectory
