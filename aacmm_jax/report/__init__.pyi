from .html_page import write_report as write_report
