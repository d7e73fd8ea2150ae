"""Provide models that several nodes use: functions of arrays that open no sockets or files."""
