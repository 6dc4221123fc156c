{{/* Names of the cluster's nodes of a class, in order, as a JSON list; take a class. Empty where no cluster is asked (helm template). */}}
{{- define "fractus-demo.nodes" -}}
{{- $names := list }}
{{- range (lookup "v1" "Node" "" "").items }}
{{- if eq (dig "metadata" "labels" "fractus.dev/class" "" .) $ }}
{{- $names = append $names .metadata.name }}
{{- end }}
{{- end }}
{{- toJson (sortAlpha $names) }}
{{- end }}

{{/* Name of the node that is the drone. */}}
{{- define "fractus-demo.drone" -}}
{{- $found := include "fractus-demo.nodes" "drone" | fromJsonArray }}
{{- if .Values.drone }}
{{- .Values.drone }}
{{- else if $found }}
{{- first $found }}
{{- else }}
{{- fail "no node has the label fractus.dev/class=drone; label one (kubectl label node NODE fractus.dev/class=drone) or name it: --set drone=NODE" }}
{{- end }}
{{- end }}
