"""Files that survive kill -9 and power loss: a reader sees the old content or the new, never a part; and audit logs."""

from fractus_storage.files import read_set, remove_file, remove_temporary, write_file, write_set

__all__ = ["read_set", "remove_file", "remove_temporary", "write_file", "write_set"]
