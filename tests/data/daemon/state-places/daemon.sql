BEGIN TRANSACTION;
CREATE TABLE audit (
    id integer primary key, t real not null, by text not null, what text not null, campaign text not null,
    detail text not null
) strict;
CREATE TABLE campaign (
    id text primary key, name text not null, task text not null, rig text not null, mode text not null,
    priority integer not null, rank real not null, state text not null, desired_state text not null,
    reason text not null,
    by text not null, created real not null, begun real, ended real, run text, motion_enabled integer not null,
    answers text not null check (json_valid(answers)),
    caller_id text not null default '', body_hash text not null default '', not_before real,
    verdict text check (verdict is null or json_valid(verdict)), after text check (after is null or json_valid(after))
) strict;
CREATE TABLE flag (name text primary key, value text not null check (json_valid(value))) strict;
CREATE TABLE liquid (
    id text primary key, code text unique, properties text not null check (json_valid(properties)),
    created real not null
) strict;
INSERT INTO "liquid" VALUES('water',NULL,'{"name": "water"}',1700000001.0);
INSERT INTO "liquid" VALUES('oil',NULL,'{"name": "water", "density": "0.92 g/mL"}',1700000002.0);
CREATE TABLE node_action (
    id text primary key, name text not null, args text not null check (json_valid(args)), created real not null,
    started real, error text, json_result text
) strict;
CREATE TABLE position (
    id text primary key, code text unique, rig text not null, note text not null, created real not null
) strict;
INSERT INTO "position" VALUES('source/water',NULL,'left','',1700000003.0);
INSERT INTO "position" VALUES('rack/A1','P-A1','left','',1700000004.0);
INSERT INTO "position" VALUES('rack/A2','P-A2','left','',1700000005.0);
INSERT INTO "position" VALUES('rack/B1','P-B1','left','',1700000006.0);
INSERT INTO "position" VALUES('rack/B2','P-B2','left','',1700000007.0);
INSERT INTO "position" VALUES('rack/C1','P-C1','left','',1700000008.0);
INSERT INTO "position" VALUES('shelf',NULL,'left','',1700000009.0);
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
INSERT INTO "vessel" VALUES('can',NULL,'{"name": "can", "profile": {"unit": "mm", "inner": [[0, 0], [40, 0], [40, 100]], "wall": "4 mm", "floor": "4 mm"}, "grip": {"mass": "312 g"}}',0.000502654824574367,'source/water',NULL,1700000010.0);
INSERT INTO "vessel" VALUES('cup-1',NULL,'{"name": "cup-1", "profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}, "grip": {"mass": "90 g"}}',1.97040691233151850489e-04,'rack/A1',NULL,1700000012.0);
INSERT INTO "vessel" VALUES('cup-2',NULL,'{"name": "cup-2", "profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}, "grip": {"mass": "90 g"}}',1.97040691233151850489e-04,'rack/B2',NULL,1700000014.0);
INSERT INTO "vessel" VALUES('cup-3',NULL,'{"name": "cup-3", "profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}, "grip": {"mass": "90 g"}}',1.97040691233151850489e-04,'rack/C1',NULL,1700000016.0);
INSERT INTO "vessel" VALUES('cup-4',NULL,'{"name": "cup-4", "profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}, "grip": {"mass": "90 g"}}',1.97040691233151850489e-04,'shelf',NULL,1700000018.0);
INSERT INTO "vessel" VALUES('cup-5',NULL,'{"name": "cup-5", "profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}, "grip": {"mass": "90 g"}}',1.97040691233151850489e-04,'rack/B1',NULL,1700000020.0);
CREATE UNIQUE INDEX campaign_by_caller_id on campaign (caller_id) where caller_id != '';
CREATE INDEX campaign_by_state on campaign (state, rig);
CREATE INDEX question_open on question (closed, answered);
CREATE TRIGGER audit_is_never_changed before update on audit begin
    select raise(abort, 'audit entries are append-only'); end;
CREATE TRIGGER audit_is_never_deleted before delete on audit begin
    select raise(abort, 'audit entries are append-only'); end;
CREATE INDEX order_by_source on pour_order (source);
COMMIT;
pragma user_version = 6;
