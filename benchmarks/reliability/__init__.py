"""The promises of ``docs/reliability.md``, measured: a module for each kind of fault.

They write only to temporary folders, and print a table; the exit code is 1 if a promise is broken.
"""
