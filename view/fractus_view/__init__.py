"""The live view: one web page of flights, from recordings or a cluster, served by a small server that only reads."""
