"""Hold example scripts that train policies, each of which can be copied and changed."""
