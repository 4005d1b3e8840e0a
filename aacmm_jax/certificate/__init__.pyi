from .document import dcc_xml as dcc_xml
from .printed import certificate_html as certificate_html
from .printed import certificate_pdf as certificate_pdf
from .xml_elements import CertifiedValue as CertifiedValue
from .xml_elements import parse_dcc as parse_dcc
