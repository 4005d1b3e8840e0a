"""Acceptance tests after JJF 1408, ASME B89.4.22 and ISO 10360-12."""
