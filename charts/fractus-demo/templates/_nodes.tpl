{{/* Names of the nodes of a class, sorted, as a JSON list. Argument: the class. Empty without a cluster (helm template). */}}
{{- define "fractus-demo.nodes" -}}
{{- $names := list }}
{{- range (lookup "v1" "Node" "" "").items }}
{{- if eq (dig "metadata" "labels" "fractus.dev/class" "" .) $ }}
{{- $names = append $names .metadata.name }}
{{- end }}
{{- end }}
{{- toJson (sortAlpha $names) }}
{{- end }}

{{/* Image of a part. Argument: (dict "root" $ "part" "sim"). */}}
{{- define "fractus-demo.image" -}}
{{- $image := .root.Values.image }}
{{- with get ($image.digests | default dict) .part }}
{{- printf "%s/%s@%s" $image.registry $.part . }}
{{- else }}
{{- printf "%s/%s:%s" $image.registry .part ($image.tag | default .root.Chart.AppVersion) }}
{{- end }}
{{- end }}

{{/* Name of the node that this release chose as the drone. The choice stays if nodes are added or removed. */}}
{{- define "fractus-demo.previous" -}}
{{- if .Release.IsUpgrade }}
{{- dig "metadata" "annotations" "fractus.dev/node" "" (lookup "apps/v1" "DaemonSet" .Release.Namespace (printf "%s-vehicle" .Release.Name)) }}
{{- end }}
{{- end }}

{{/* Name of the drone node. */}}
{{- define "fractus-demo.drone" -}}
{{- $previous := include "fractus-demo.previous" . }}
{{- if and $previous .Values.drone (ne $previous .Values.drone) }}
{{- fail (printf "drone: %s is the drone of this release; to use %s instead, uninstall the release and install it again" $previous .Values.drone) }}
{{- else if or .Values.drone $previous }}
{{- .Values.drone | default $previous }}
{{- else }}
{{- $found := include "fractus-demo.nodes" "drone" | fromJsonArray }}
{{- if not $found }}
{{- fail "no node has the label fractus.dev/class=drone; label a node (kubectl label node NODE fractus.dev/class=drone), or specify its name: --set drone=NODE" }}
{{- end }}
{{- first $found }}
{{- end }}
{{- end }}
