"""States against time with limits that are counted only and with limits that are enforced."""
