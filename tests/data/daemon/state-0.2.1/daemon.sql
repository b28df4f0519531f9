BEGIN TRANSACTION;
CREATE TABLE audit (
    id integer primary key, t real not null, by text not null, what text not null, campaign text not null,
    detail text not null
) strict;
INSERT INTO "audit" VALUES(1,1.79581013203369212151e+09,'operator','submit','cup-28dbed','');
INSERT INTO "audit" VALUES(2,1.79581013508611297612e+09,'operator','pause queue','','');
INSERT INTO "audit" VALUES(3,1.79581013529776406284e+09,'operator','submit','cup-b84b18','');
INSERT INTO "audit" VALUES(4,1.79581013557390046118e+09,'operator','register liquid','','water');
CREATE TABLE campaign (
    id text primary key, name text not null, task text not null, rig text not null, mode text not null,
    priority integer not null, rank real not null, state text not null, desired_state text not null,
    reason text not null,
    by text not null, created real not null, begun real, ended real, run text, motion_enabled integer not null,
    answers text not null check (json_valid(answers)),
    caller_id text not null default '', body_hash text not null default '', not_before real
) strict;
INSERT INTO "campaign" VALUES('cup-28dbed','cup','run','virtual','virtual',0,1.0,'finished','pause','','operator',1.79581013202966332433e+09,1795810132.03542,1.7958101347091960907e+09,'cup-20261127-1',0,'{}','first','94acc353d9817b4be288fdac0e3004d119fd00d46d06e19c0221f38dcd10812a',NULL);
INSERT INTO "campaign" VALUES('cup-b84b18','cup','run','virtual','virtual',2,2.0,'queued','run','','operator',1.79581013529001164434e+09,NULL,NULL,NULL,0,'{}','second','f2ca38d531915f386b59ff903f290c6c0435eefa8d227f7143ea87afac757689',NULL);
CREATE TABLE flag (name text primary key, value text not null check (json_valid(value))) strict;
INSERT INTO "flag" VALUES('paused','{"by": "operator", "time": 1795810135.0707798}');
INSERT INTO "flag" VALUES('charts','{}');
CREATE TABLE liquid (
    id text primary key, code text unique, properties text not null check (json_valid(properties)),
    created real not null
) strict;
INSERT INTO "liquid" VALUES('water',NULL,'{"name": "water"}',1.79581013556408524518e+09);
CREATE TABLE node_action (
    id text primary key, name text not null, args text not null check (json_valid(args)), created real not null,
    started real, error text, json_result text
) strict;
CREATE TABLE position (
    id text primary key, code text unique, rig text not null, note text not null, created real not null
) strict;
CREATE TABLE pour_order (
    id text primary key, campaign text not null unique, body text not null check (json_valid(body)),
    source text not null, receiver text not null, amount real,
    predicted text check (predicted is null or json_valid(predicted)),
    result text check (result is null or json_valid(result))
) strict;
CREATE TABLE question (
    id integer primary key, campaign text not null, rig text not null, kind text not null, about text not null,
    text text not null, problem text not null, wants text not null, options text not null check (json_valid(options)),
    details text not null check (json_valid(details)), hands integer not null, asked real not null,
    answer text, by text, answered real, closed text
) strict;
CREATE TABLE vessel (
    id text primary key, code text unique, shape text not null check (json_valid(shape)), capacity real not null,
    position text unique, liquid text, created real not null
) strict;
CREATE UNIQUE INDEX campaign_by_caller_id on campaign (caller_id) where caller_id != '';
CREATE INDEX campaign_by_state on campaign (state, rig);
CREATE INDEX question_open on question (closed, answered);
CREATE TRIGGER audit_is_never_changed before update on audit begin
    select raise(abort, 'audit entries are append-only'); end;
CREATE TRIGGER audit_is_never_deleted before delete on audit begin
    select raise(abort, 'audit entries are append-only'); end;
CREATE INDEX order_by_source on pour_order (source);
COMMIT;
pragma user_version = 5;
