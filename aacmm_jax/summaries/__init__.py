"""Sentences and tables that command line, report and JSON share.

Warnings about captures and calibrations, pose outliers among them, are worded in `warnings`.
"""
