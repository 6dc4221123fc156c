"""`python -m fractus_services.mobility`: the mobility service of a drone."""

from fractus_services.commands import mobility

if __name__ == "__main__":
    mobility()
