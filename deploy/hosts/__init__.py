"""Files by which the processes of the graph are started on other hosts: Docker Compose, Kubernetes, systemd."""
