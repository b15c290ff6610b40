"""Pages in a browser that show, compose and compare robots.

``pages`` has the pages, ``scene`` draws into viser's 3D scene, ``app`` is the server: ``session``
is one browser, ``server`` and ``uploads`` are the boundary to browsers, ``address`` has the table
of pages. ``robot_uri`` finds what an address names among the allowed files.
"""
