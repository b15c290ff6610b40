"""Pages in a browser that show, compose and compare robots.

Modules by name: ``page_*`` is a page (``pages`` is their table), ``scene_*`` draws into viser's 3D
scene, ``session`` is one browser, ``server``, ``access``, ``messages`` and ``uploads`` are the
boundary to browsers, and ``robot_uri`` finds what an address names among the allowed files.
"""
