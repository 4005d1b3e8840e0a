from .document import dcc_xml as dcc_xml
from .printed import PrintedCertificate as PrintedCertificate
from .printed import printed_certificate as printed_certificate
from .xml_elements import CertifiedValue as CertifiedValue
from .xml_elements import parse_dcc as parse_dcc
