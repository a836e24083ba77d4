"""Studies beside the packages: each uses what users have, and no package imports one."""
