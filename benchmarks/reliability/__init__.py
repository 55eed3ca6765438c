"""What ``docs/reliability.md`` promises, measured: one module, one command for each kind of fault.

They write only to temporary folders, and print a table; the exit code is 1 if a promise is broken.
"""
