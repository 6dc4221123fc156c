{{/*
Sets missing values to their defaults. `helm upgrade --reuse-values` keeps the values of the previous release, which lack
the values that a newer chart adds. Each template includes it, because the rendering order is undefined.
*/}}
{{- define "fractus.defaults" }}
{{- include "fractus.fill" (dict "values" .Values "defaults" (.Files.Get "files/values.yaml" | fromYaml)) }}
{{- end }}
{{- define "fractus.fill" }}
{{- range $key, $default := .defaults }}
{{- if not (hasKey $.values $key) }}
{{- $_ := set $.values $key $default }}
{{- /* Removed limits and labels stay removed. */}}
{{- else if and (kindIs "map" $default) (not (has $key (list "resources" "labels"))) }}
{{- include "fractus.fill" (dict "values" (index $.values $key) "defaults" $default) }}
{{- end }}
{{- end }}
{{- end }}

{{/* Labels of every object of this release. Argument: (dict "root" $ "part" "agent"). */}}
{{- define "fractus.labels" -}}
app.kubernetes.io/name: fractus
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
app.kubernetes.io/part-of: fractus
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end }}

{{/* Labels that select the pods of a part. */}}
{{- define "fractus.selector" -}}
app.kubernetes.io/name: fractus
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{/* CEL: true if the request comes from an agent, including agents of an earlier release that are not yet replaced. */}}
{{- define "fractus.byAnAgent" -}}
request.userInfo.username in ["system:serviceaccount:{{ .Release.Namespace }}:fractus-node", "system:serviceaccount:{{ .Release.Namespace }}:fractus-agent"]
{{- end }}

{{/* CEL: the node that the token of the requester is bound to, or an empty string. */}}
{{- define "fractus.callersNode" -}}
has(request.userInfo.extra) && "authentication.kubernetes.io/node-name" in request.userInfo.extra
&& size(request.userInfo.extra["authentication.kubernetes.io/node-name"]) == 1
? request.userInfo.extra["authentication.kubernetes.io/node-name"][0] : ""
{{- end }}

{{/* Binding of an admission policy that is evaluated for each object of its paramKind. Argument: (dict "root" $ "name" "fractus-flight-pods"). */}}
{{- define "fractus.bindingForEach" }}
---
apiVersion: admissionregistration.k8s.io/v1
kind: ValidatingAdmissionPolicyBinding
metadata:
  name: {{ .name }}
  labels: {{- include "fractus.labels" (dict "root" .root "part" "admission") | nindent 4 }}
spec:
  policyName: {{ .name }}
  paramRef:
    selector: {}
    parameterNotFoundAction: Allow
  validationActions: [Deny]
{{- end }}

{{/* Namespace of the accounts and Grants of nodes. fractus_core.api.grants uses the same name. */}}
{{- define "fractus.nodesNamespace" -}}fractus-nodes{{- end }}

{{/* Image of a part. Argument: (dict "root" $ "part" "agent"). */}}
{{- define "fractus.image" -}}
{{- $image := .root.Values.image }}
{{- with get ($image.digests | default dict) .part }}
{{- printf "%s/%s@%s" $image.registry $.part . | quote }}
{{- else }}
{{- printf "%s/%s:%s" $image.registry .part ($image.tag | default .root.Chart.AppVersion) | quote }}
{{- end }}
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

{{/* Listen address for metrics of nodes: localhost, node (address of the node, not reachable over direct links), or empty. */}}
{{- define "fractus.nodeMetrics" -}}
{{- with .Values.metrics }}
{{- if .nodes.enabled }}{{ ternary (ternary "node" "localhost" .podMonitor.enabled) .nodes.address (eq .nodes.address "auto") }}{{ end }}
{{- end }}
{{- end }}

{{/* Listen address for metrics of a workload. Argument: (dict "root" $ "port" 46812). */}}
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

{{/* Security context that runs as root to write the node's directories, without other privileges. Argument: (dict "privileged" false). */}}
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

{{/* Security context of the gateway's user. */}}
{{- define "fractus.gatewaySecurity" -}}
runAsUser: 10002
runAsGroup: 10002
runAsNonRoot: true
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
seccompProfile: {type: RuntimeDefault}
{{- end }}

{{/* CEL: true if a pod may run on drones and edge nodes. Argument: name of the variable that holds the pod. */}}
{{- define "fractus.tolerates" -}}
{{ . }}.spec.?tolerations.orValue([]).exists(t, t.?key.orValue("") in ["", "fractus.dev/class"])
{{- end }}
