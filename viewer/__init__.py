"""Pages in a browser on which robots are looked at, composed and compared."""
