"""Zips and descriptions that tests upload to the viewer."""

import io
import zipfile

URDF = b'<robot name="r"><link name="a"/></robot>'


def archive(files, how=zipfile.ZIP_STORED):
    """Return a zip of files by their paths."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", how) as made:
        for name, data in files.items():
            made.writestr(name, data)
    return content.getvalue()
