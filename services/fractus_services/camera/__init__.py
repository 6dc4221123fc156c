"""The camera service: policy-checked pictures from a drone or an edge node."""
