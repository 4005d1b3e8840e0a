"""Tables in files that are not text. One module a format; `sources` knows them all.

A module has ``read(members, tables, corners)``, which returns the lines of a table as a text file would have them, with
tabs between the cells. So whatever a manifest may say of a text table, it may say of these. The modules are imported
and run by the process of `reader_process` alone.
"""
