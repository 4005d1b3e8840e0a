from .html_page import write_plan as write_plan
from .html_page import write_report as write_report
