"""The attacks of benchmarks/hostile.py, a module for each kind; the tests run a small part of every one."""
