"""The command line, the process table and the supervision of the processes."""
