"""Pages to look at in a browser: self-contained HTML files, with no server and no network.

Their scripts and styles are the files in ``static``.
"""
