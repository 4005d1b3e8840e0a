from .document import dcc as dcc
from .document import parse_dcc as parse_dcc
