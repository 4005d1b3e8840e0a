"""Sentences and tables that command line, report and JSON share."""
