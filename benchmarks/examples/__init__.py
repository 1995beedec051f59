"""Hold example scripts that train policies, to copy and change."""
