"""The server of the viewer, its sessions, uploads and workers."""
