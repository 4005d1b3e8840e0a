from .html_page import write_plan as write_plan
from .html_page import write_report as write_report
from .html_page import write_verification as write_verification
