"""Files of robots' controllers, one module a format.

A further format that takes zero offsets only is a module with a function of the user's file, the offsets and the names
of motors, and a line in `ZERO_FILES`.
"""

from .kuka import kuka_machine_data
from .lerobot import lerobot_calibration

# By the name that ``export`` has for the format.
ZERO_FILES = {"lerobot": lerobot_calibration, "kuka": kuka_machine_data}
