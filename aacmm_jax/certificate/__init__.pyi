from .document import dcc_xml as dcc_xml
from .parsing import CertifiedValue as CertifiedValue
from .parsing import parse_dcc as parse_dcc
