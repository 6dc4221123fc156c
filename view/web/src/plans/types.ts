// Objects of the management API, as far as the page uses them. A test compares them with management/openapi.json.

export interface Point {
  lat: number;
  lon: number;
}

export interface Position {
  lat: number;
  lon: number;
  alt?: number | null;
  altitudeReference?: string;
}

export interface Circle {
  center: Point;
  radius: number;
}

export interface Polygon {
  exterior: Point[];
  holes?: Point[][];
}

export interface Area {
  circle?: Circle | null;
  polygon?: Polygon | null;
}

export interface Metadata {
  name: string;
  namespace?: string | null;
  resourceVersion?: string | null;
  generation?: number | null;
}

export interface Condition {
  type: string;
  status: string;
  reason: string;
  message?: string;
}

export interface FlightWindow {
  start: string;
  duration: number;
}

export interface PolicyAction {
  policy: string;
  action: string;
  landAt?: Point | null;
}

export interface ContactLoss {
  action?: string;
  landAt?: Point | null;
}

export interface FlightPlanSpec {
  template: string;
  parameters?: object;
  waypoints?: Position[] | null;
  region?: Area | null;
  stay?: number | null;
  window: FlightWindow;
  drone?: string | null;
  priorityClass?: string;
  policyActions?: PolicyAction[];
  contactLost?: ContactLoss | null;
  use?: string;
  autoActivate?: boolean;
}

export interface PlanFinding {
  reason: string;
  message: string;
  plan?: string | null;
}

export interface PlanRestriction {
  policy: string;
  choices?: string[];
  chosen?: string | null;
}

export interface ReservedVolume {
  areas: Area[];
  lower?: number | null;
  upper?: number | null;
  begin: string;
  end: string;
}

export interface Alternative {
  node: string;
  score: number;
}

export interface Rejection {
  node: string;
  message: string;
}

export interface FlightPlanStatus {
  state?: string | null;
  message?: string | null;
  drone?: string | null;
  application?: string | null;
  candidates?: Alternative[];
  rejected?: Rejection[];
  volumes?: ReservedVolume[];
  offNominalVolumes?: ReservedVolume[];
  restrictions?: PlanRestriction[];
  refusals?: PlanFinding[];
  advisories?: PlanFinding[];
  conditions?: Condition[];
}

export interface FlightPlan {
  metadata: Metadata;
  spec: FlightPlanSpec;
  status?: FlightPlanStatus | null;
}

export interface FlightVerdict {
  time: string;
  kind: string;
  component?: string;
  method?: string;
  action: string;
  code?: string;
  reason?: string;
  policies?: string[];
}

export interface TrackPoint {
  time: string;
  lat?: number | null;
  lon?: number | null;
  alt?: number | null;
  speed?: number | null;
  inAir: boolean;
}

export interface RecordedPicture {
  id: string;
  time: string;
  component: string;
  sizeBytes: number;
}

export interface ApplicationTemplateSpec {
  description?: string;
  navigation: string;
  parameters?: object;
}

export interface ApplicationTemplateStatus {
  conditions?: Condition[];
}

export interface ApplicationTemplate {
  metadata: Metadata;
  spec: ApplicationTemplateSpec;
  status?: ApplicationTemplateStatus | null;
}

export interface DroneStatus {
  position?: Position | null;
}

export interface Drone {
  metadata: Metadata;
  status?: DroneStatus | null;
}

export interface AltitudeBand {
  lower?: number | null;
  upper?: number | null;
  reference?: string;
}

export interface ActiveTime {
  days?: string[];
  start?: string | null;
  end?: string | null;
}

export interface ZoneSpec {
  description?: string;
  area: Area;
  altitude?: AltitudeBand | null;
  schedule?: ActiveTime[];
}

export interface PolicySpec {
  type: string;
  kind: string;
  action?: string | null;
  choices?: string[];
  methods?: string[];
  lowerLimit?: number | null;
  upperLimit?: number | null;
  altitudeReference?: string;
  landAt?: Point | null;
  faces?: string | null;
  fallback?: string | null;
  priority?: number;
  validFrom?: string | null;
  validUntil?: string | null;
}

export interface ReadyStatus {
  conditions?: Condition[];
}

export interface NewRestriction {
  name: string;
  zone: ZoneSpec;
  policy: PolicySpec;
}

export interface Restriction {
  name: string;
  zone?: ZoneSpec | null;
  policy: PolicySpec;
  status?: ReadyStatus | null;
}

export interface AffectedPlan {
  namespace: string;
  name: string;
  state: string;
  drone?: string | null;
  begin: string;
  end: string;
}

export interface AffectedFlight {
  namespace: string;
  application: string;
  drone: string;
}

export interface Impact {
  plans: AffectedPlan[];
  flights: AffectedFlight[];
  unreadable: string[];
}

export interface Permissions {
  publishRestrictions: boolean;
  prioritize: boolean;
}
