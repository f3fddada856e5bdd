"""The choice of poses whose measurement tells most."""
