from .document import dcc_xml as dcc_xml
from .xml_elements import CertifiedValue as CertifiedValue
from .xml_elements import parse_dcc as parse_dcc
