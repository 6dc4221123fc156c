module fractus.dev/binaries/pause

go 1.25.0
