{{/*
Gives values that are missing their defaults. `helm upgrade --reuse-values` keeps the values of the release before, which does
not have those that a newer chart has added. Each template starts with it, for they are rendered in no order.
*/}}
{{- define "fractus.defaults" }}
{{- include "fractus.fill" (dict "values" .Values "defaults" (.Files.Get "files/values.yaml" | fromYaml)) }}
{{- end }}
{{- define "fractus.fill" }}
{{- range $key, $default := .defaults }}
{{- if not (hasKey $.values $key) }}
{{- $_ := set $.values $key $default }}
{{- /* Who leaves a limit or a label out means it. */}}
{{- else if and (kindIs "map" $default) (not (has $key (list "resources" "labels"))) }}
{{- include "fractus.fill" (dict "values" (index $.values $key) "defaults" $default) }}
{{- end }}
{{- end }}
{{- end }}

{{/* Labels of every object of this release; take (dict "root" $ "part" "agent"). */}}
{{- define "fractus.labels" -}}
app.kubernetes.io/name: fractus
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
app.kubernetes.io/part-of: fractus
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end }}

{{/* Labels that select the pods of one part. */}}
{{- define "fractus.selector" -}}
app.kubernetes.io/name: fractus
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{/* CEL: whether an agent asks, also one of an earlier release that has yet to be replaced. */}}
{{- define "fractus.byAnAgent" -}}
request.userInfo.username in ["system:serviceaccount:{{ .Release.Namespace }}:fractus-node", "system:serviceaccount:{{ .Release.Namespace }}:fractus-agent"]
{{- end }}

{{/* CEL: the node that the token of who asks is bound to; empty where it is bound to none. */}}
{{- define "fractus.callersNode" -}}
has(request.userInfo.extra) && "authentication.kubernetes.io/node-name" in request.userInfo.extra
&& size(request.userInfo.extra["authentication.kubernetes.io/node-name"]) == 1
? request.userInfo.extra["authentication.kubernetes.io/node-name"][0] : ""
{{- end }}

{{/* Where each node has an account of its own, and its Grants; fractus_core.api.node_grants knows it by this name. */}}
{{- define "fractus.nodesNamespace" -}}fractus-nodes{{- end }}

{{/* The image of a part; take (dict "root" $ "part" "agent"). */}}
{{- define "fractus.image" -}}
{{- with .root }}{{ printf "%s/%s:%s" .Values.image.registry $.part (.Values.image.tag | default .Chart.AppVersion) | quote }}{{ end }}
{{- end }}

{{- define "fractus.pullSecrets" -}}
{{- with .Values.imagePullSecrets }}
imagePullSecrets:
{{- range . }}
  - name: {{ . }}
{{- end }}
{{- end }}
{{- end }}

{{- define "fractus.logEnv" -}}
- {name: FRACTUS_LOG_LEVEL, value: {{ .Values.logLevel | quote }}}
- {name: FRACTUS_LOG_FORMAT, value: {{ .Values.logFormat | quote }}}
{{- end }}

{{/* Where nodes tell their metrics: localhost, node (their own address, out of reach over direct links), or nothing. */}}
{{- define "fractus.nodeMetrics" -}}
{{- with .Values.metrics }}
{{- if .nodes.enabled }}{{ ternary (ternary "node" "localhost" .podMonitor.enabled) .nodes.address (eq .nodes.address "auto") }}{{ end }}
{{- end }}
{{- end }}

{{/* The same for a workload; takes (dict "root" $ "port" 46812). */}}
{{- define "fractus.nodeMetricsEnv" -}}
{{- $where := include "fractus.nodeMetrics" .root }}
{{- if eq $where "node" }}
- {name: FRACTUS_HOST, valueFrom: {fieldRef: {fieldPath: status.hostIP}}}
- {name: FRACTUS_METRICS, value: "$(FRACTUS_HOST):{{ .port }}"}
{{- else if $where }}
- {name: FRACTUS_METRICS, value: "127.0.0.1:{{ .port }}"}
{{- end }}
{{- end }}
{{- define "fractus.nodeMetricsPort" -}}
{{- if eq (include "fractus.nodeMetrics" .root) "node" }}
- {name: metrics, containerPort: {{ .port }}, hostPort: {{ .port }}}
{{- end }}
{{- end }}

{{/* Root, to write the node's directories, and nothing beyond but what is added; take (dict "privileged" false). */}}
{{- define "fractus.nodeSecurity" -}}
{{- if .privileged }}
privileged: true
readOnlyRootFilesystem: true
{{- else }}
runAsUser: 0
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]{{ with .add }}, add: {{ toJson . }}{{ end }}}
seccompProfile: {type: RuntimeDefault}
{{- end }}
{{- end }}

{{/* CEL: whether a pod may run on drones and edge nodes; takes the name of the variable that holds the pod. */}}
{{- define "fractus.tolerates" -}}
{{ . }}.spec.?tolerations.orValue([]).exists(t, t.?key.orValue("") in ["", "fractus.dev/class"])
{{- end }}
