"""A file with given contents."""

import pytest


@pytest.fixture
def save(tmp_path):
    def write(content, name="telemetry.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
